"""Floor 4: how anything is fitted."""
