"""Real processes, real faults, and what they cost: time, and nothing else.

A simulator can try millions of faults, but it is itself an assumption about what machines do. Here
robots and services are the commands that anyone can type, on this machine's own network, and they
are killed, stopped and cut off as it happens in the field. Each run is compared with the same run
without faults, and the world that the robot acts on keeps a list of its own of what was done to it.

Nothing here looks into a process: what is measured is what each of them writes for everybody.
"""
