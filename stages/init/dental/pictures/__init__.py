"""What is drawn of the teeth for people to check."""
