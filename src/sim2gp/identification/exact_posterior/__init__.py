"""The exact posterior: importance weights and Hamiltonian Monte Carlo."""
