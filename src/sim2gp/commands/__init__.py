"""What the commands run: a module for each, and what they share."""
