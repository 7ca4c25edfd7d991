"""Four tests of what a fit leaves over, and their findings in words."""
