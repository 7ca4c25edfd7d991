"""What the commands run: each module is one experiment, each writes one run."""
