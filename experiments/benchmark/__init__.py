"""How well the main job does, and how sure that is."""
