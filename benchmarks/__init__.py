"""How fast holdfast is, measured against a plain implementation of the same algorithm."""
