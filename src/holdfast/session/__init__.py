"""Sessions without sockets: what a robot and a service say to each other, and when.

Nothing in here reads a clock, opens a socket, starts a thread or sleeps. Each machine takes an
event and the time and returns effects in the order in which they must be carried out. So the same
code runs over sockets, inside one process, and in the fault simulator.
"""
