"""Plants: three bundled machines, a user's equation, a simulator on the host."""
