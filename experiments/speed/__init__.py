"""Time and memory of training, rendering and the player."""
