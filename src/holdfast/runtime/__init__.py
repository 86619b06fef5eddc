"""The shells: what touches clocks, processes and the world, so that planning does not have to."""
