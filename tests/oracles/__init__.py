"""Independent reference answers for the tests: plain numpy and scipy."""
