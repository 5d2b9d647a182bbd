"""Images that show depth, flow, errors and curves."""
