"""What robots and services need of the operating system: logs, workers, descriptors, systemd."""
