"""``holdfast demo``: a cloud and a robot are killed, and no decision changes."""
