"""The front: what the command line calls, and how it shows what it hears."""
