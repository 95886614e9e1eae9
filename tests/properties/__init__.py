"""Mechanisms put together at random, and what must hold of each."""
