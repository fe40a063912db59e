"""`mr360 bench`: what the frame path costs, measured the same way every time."""
