"""Which objects of a view are shaded anew when the light has changed: all of them, or live a few at a time, in turn.

Light changes slowly and is read from an earlier frame anyway; shading is what costs most. What is new, or lit by a light that has
nothing to do with the last one, never waits.
"""

from __future__ import annotations

MIN_PIXELS = 12_000        # that are shaded ahead of one frame, however small the share that `quality.py` names
MOST_FRAMES = 4            # without time ahead of them, in which a view's objects are shaded one after another

LitBy = tuple[int, int]     # numbers of the illumination and of the lights' visibility


class Turns:
    """What each object of one view was last shaded by."""

    def __init__(self) -> None:
        self._lit_by: dict[int, LitBy] = {}     # in the order of their turns
        self._had_turn = False                  # ahead of the frame that comes
        self.waited = 0                         # turns without any
        self.is_behind = False                  # some have not been shaded by the newest light

    def ahead(self, members: dict[int, int], lit_by: LitBy, pixels: float) -> list[int]:
        """Those to shade ahead of a frame, which then has had its turn; they count as shaded. `members`: pixels of each object;
        those that are new are shaded whatever they cost, then those that have waited longest, as many `pixels` as there are.
        What is left of turns without any is saved up, so that an object larger than that has its turn too."""
        new, stale = self._due(members, lit_by)
        affordable: list[int] = []
        pixels = max(pixels, 0.0) * (1 + self.waited)
        for index in stale:
            pixels -= members[index]
            if pixels < 0:
                break
            affordable.append(index)
        self.waited = self.waited + 1 if stale and not affordable else 0
        self.is_behind = len(affordable) < len(stale)
        self._had_turn = True
        return self._marked([*new, *affordable], lit_by)

    def now(self, members: dict[int, int], lit_by: LitBy, *, patient: bool) -> list[int]:
        """Those to shade for a frame. `patient`: what was left out ahead of it may wait; if there was no time for that, some of
        what has waited longest is shaded, not all at once."""
        new, stale = self._due(members, lit_by)
        if patient:
            stale = [] if self._had_turn else stale[:-(-len(stale) // MOST_FRAMES)]
        self._had_turn = False
        chosen = self._marked([*new, *stale], lit_by)
        self.is_behind = bool(self._due(members, lit_by)[1])
        return chosen

    def _due(self, members: dict[int, int], lit_by: LitBy) -> tuple[list[int], list[int]]:
        return ([index for index in members if index not in self._lit_by],
                [index for index, found in self._lit_by.items() if found != lit_by and index in members])

    def _marked(self, chosen: list[int], lit_by: LitBy) -> list[int]:
        for index in chosen:
            self._lit_by.pop(index, None)
            self._lit_by[index] = lit_by
        return chosen
