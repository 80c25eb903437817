"""Training of a KeypointNet: views, losses, lessons, the loop (loop.py) and what it leaves behind (trainer.py)."""
