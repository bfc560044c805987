"""What a process has only one of: its signals, its file mask, what native libraries do to both."""
