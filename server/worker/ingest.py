"""The ingest thread: keeps the stream's source open, retries for ever, hands over the newest frame."""

from __future__ import annotations

import logging
import random
import threading
from collections.abc import Callable
from dataclasses import replace

from server.worker.named_thread import NamedThread
from server.worker.newest import Newest
from server.worker.output_clock import OutputClock
from server.worker.sound import Sound
from server.worker.sound_decoder import Heard
from server.worker.source import LISTEN_SCHEME, Decoded, Source, SourceError, SourceInfo

logger = logging.getLogger(__name__)
FIRST_PAUSE_S = 0.5
LONGEST_PAUSE_S = 5.0
StateCallback = Callable[[str, str | None, SourceInfo | None], None]


class Ingest:
    """Pulls one URL. `on_state(state, detail, info)` is called from the thread on every change. Pictures go to `frames`, sound to
    `sound` if that is given, both with their moments on the clock.

    A blocked read cannot be interrupted from outside, only run into its time limit; `stop` therefore disowns the thread,
    which ends by itself and delivers nothing more.
    """

    def __init__(self, url: str, *, allow_files: bool, frames: Newest[Decoded], on_state: StateCallback,
                 clock: OutputClock | None = None, sound: Sound | None = None) -> None:
        self._url = url
        self._allow_files = allow_files
        self._frames = frames
        self._on_state = on_state
        self._clock = clock or OutputClock(0)
        self._sound = sound
        self._stopped = threading.Event()
        self.frames_in = 0
        self._thread = NamedThread(target=self._run, name="ingest", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        pause = FIRST_PAUSE_S
        while not self._stopped.is_set():
            if self._report("connecting", None, None) and self._session():
                pause = FIRST_PAUSE_S
            listening = self._url.startswith(LISTEN_SCHEME)  # a publisher may come at any moment
            self._stopped.wait(0.0 if listening else pause * random.uniform(0.8, 1.2))
            pause = min(2 * pause, LONGEST_PAUSE_S)

    def _session(self) -> bool:
        """Open, deliver until it breaks. True when at least one frame came."""
        delivered = told_no_sound = False
        source: Source | None = None
        try:
            source = Source(self._url, allow_files=self._allow_files, listener=self)
            self._clock.new_source()
            for decoded in source.frames():
                if self._stopped.is_set():
                    return delivered
                if not delivered or source.no_sound != told_no_sound:
                    delivered, told_no_sound = True, source.no_sound
                    self._report("live", None, source.info)
                self.frames_in += 1
                self._frames.put(replace(decoded, moment=self._clock.moment(decoded.pts, decoded.decoded_at)))
        except SourceError as error:
            self._report("lost", str(error), None)
        except Exception as error:  # a decoder's surprise must not end the stream
            logger.exception("ingest of %s failed", self._url.split("@")[-1])
            self._report("lost", f"source failed: {error}", None)
        finally:
            if source is not None:
                source.close()
        return delivered

    @property
    def wanted(self) -> bool:
        """Whether sound is."""
        return self._sound is not None and self._sound.wanted and not self._stopped.is_set()

    def hear(self, heard: Heard) -> None:
        """Sound from the source, at its place on the clock; what has none is lost."""
        moment = self._clock.sound_moment(heard.pts, heard.decoded_at)
        if self._sound is not None and moment is not None:
            self._sound.put(heard, moment)

    def _report(self, state: str, detail: str | None, info: SourceInfo | None) -> bool:
        if self._stopped.is_set():
            return False
        self._on_state(state, detail, info)
        return True

    def stop(self, join_timeout: float = 0.3) -> None:
        self._stopped.set()
        self._thread.join(join_timeout)
