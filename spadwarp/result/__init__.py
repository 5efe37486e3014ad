"""What a simulation leaves behind, and its files."""
