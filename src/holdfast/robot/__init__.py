"""The robot's shell: carries out its state machine's effects, with threads, sockets and clocks."""
