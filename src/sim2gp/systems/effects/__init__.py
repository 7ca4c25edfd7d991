"""Physics that a machine may have and its plant lacks, one file for each kind."""
