"""What is done with whole runs: report, compare, benchmark. They may know stages."""
