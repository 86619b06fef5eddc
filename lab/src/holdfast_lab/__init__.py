"""The laboratory: it finds out whether the product keeps its promises, and is no part of a robot.

The simulator and the chaos series inject faults, the demo shows one failover. It is a distribution
of its own, ``holdfast-lab``, which adds its commands to ``holdfast`` by entry points
(:mod:`holdfast.cli.added_commands`). It imports the product; the product knows nothing of it.
"""
