"""Configuration: settings, a strict reader of YAML, and what is made of both."""
