"""One solve: traced, compiled, run, and what it says when it fails."""
