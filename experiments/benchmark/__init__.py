"""Quality of the main job over several seeds."""
