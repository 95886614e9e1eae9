"""A system at one instant, in the form that a method needs."""
