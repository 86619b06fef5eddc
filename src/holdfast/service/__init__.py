"""The service's process: what computes decisions for robots."""
