"""What may be wrong with a scene that is valid, in numbers."""
