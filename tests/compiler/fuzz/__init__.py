"""Programs put together at random, by our compiler and by XLA."""
