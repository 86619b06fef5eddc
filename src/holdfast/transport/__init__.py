"""The wire between robots and services: a call inside one process, and streams between them."""
