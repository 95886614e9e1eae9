"""What checks types at run time."""

from beartype import BeartypeConf, beartype


# A whole number does for a float.
checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
