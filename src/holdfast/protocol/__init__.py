"""The protocol between a robot and its services, as state machines without sockets (sans I/O).

Nothing here reads a clock, opens a socket, starts a thread or sleeps. A machine takes an event and
the time; it returns effects, which its shell carries out in their order. The same code runs over
sockets, within one process and in the fault simulator.

The robot's end: :mod:`robot` is the loop (sense, decide, write down, act), :mod:`question` what it
asks, :mod:`dispatcher` chooses the service to ask, :mod:`requests` sends and reads the replies,
:mod:`replica_set` is what is known of each service, :mod:`local_service` says when the local one is
launched, :mod:`verification` has answers recomputed, and compares. The service's end:
:mod:`service` handles requests, :mod:`service_sessions` remembers robots, :mod:`request_queue`
orders their work, :mod:`service_jobs` computes, :mod:`service_calls` replies. Both speak
:mod:`messages`.
"""
