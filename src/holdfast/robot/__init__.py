"""The robot's shell: what its state machine asks for is done here, with threads and clocks."""
