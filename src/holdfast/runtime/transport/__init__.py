"""The two ends of the wire, and two wires: Zenoh, and a call inside one process."""
