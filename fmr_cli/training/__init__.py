"""Learning: recipes, losses, the loop, and the user's scans as material."""
