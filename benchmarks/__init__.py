"""Benchmarks: run time against error, beside other solvers and a hand-written C program (see README.md)."""
