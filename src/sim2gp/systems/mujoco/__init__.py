"""MuJoCo models as plants: read, simulated, written back, drawn."""
