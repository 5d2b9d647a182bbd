"""Time and memory of training and rendering."""
