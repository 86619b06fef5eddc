"""Real processes, real faults, and a comparison: ``holdfast chaos``.

A simulator tries millions of faults, but it is an assumption about what machines do. Here robots
and services are the commands that anyone can type, on this machine's network, and they are killed,
stopped and cut off. Each run is compared with its reference run, and the world keeps its own record
of the performed actions.
"""
