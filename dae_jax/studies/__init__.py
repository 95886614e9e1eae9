"""What people do with many solves: sweeps, tuning, reductions."""
