"""`python -m dae_jax`."""

import sys

from .app.cli import main


sys.exit(main())
