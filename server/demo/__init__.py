"""The demo: a synthetic 360 camera, a publisher, a receiving viewer, and the run that puts them around a service."""
