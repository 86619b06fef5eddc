"""A robot and its services in a world where everything that can fail does, by seed.

Nothing here decides anything. The state machines of :mod:`holdfast.protocol` and the planning
beneath them run as they are in production; the shells around them, the wire, the disk and the
clocks are simulated. So a run of many processes is one ordinary function of a schedule of faults,
takes milliseconds, and goes the same way whenever it is repeated.
"""
