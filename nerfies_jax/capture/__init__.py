"""Floor 3: what was filmed. Host side, NumPy."""
