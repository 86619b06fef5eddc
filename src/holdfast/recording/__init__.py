"""What a run leaves behind: a journal, tables, a summary, the configuration and a figure."""
