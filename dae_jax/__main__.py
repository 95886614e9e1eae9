"""`python -m dae_jax`."""

import sys

from .cli import main


sys.exit(main())
