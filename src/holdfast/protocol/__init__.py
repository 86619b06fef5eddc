"""The protocol between robots and services, as state machines without input and output."""
