"""Real processes of holdfast, the networks between them, and the faults that are injected there."""
