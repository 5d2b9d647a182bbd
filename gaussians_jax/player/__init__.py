"""The web player: a page that shows a moving scene in a browser."""
