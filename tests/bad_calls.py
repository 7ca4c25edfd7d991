"""Bad inputs from 77 on: what Python is given, by what takes it."""

from bad_inputs import Case

CALLS: tuple[Case, ...] = ()
