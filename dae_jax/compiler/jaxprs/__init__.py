"""Jaxprs taken apart: walked, inlined, interpreted number by number."""
