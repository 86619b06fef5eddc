"""The laboratory: it finds out whether the product keeps its promises, and is no part of a robot.

The simulator and the chaos series inject faults, the studies compare ways of choosing what to
sense, the demo shows one failover. All of it imports the product; nothing outside this package
imports it.
"""
