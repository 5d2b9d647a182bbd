"""Quality of methods over seeds."""
