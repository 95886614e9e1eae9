"""What the user gives: wrong types, shapes and functions are refused in a sentence."""
