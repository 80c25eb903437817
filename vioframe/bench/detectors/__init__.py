"""Detectors compared: how fast they are, how well they find a place again, and how long the front-end can follow it.

speed.py times them; images.py, metrics.py and quality.py are the HPatches protocol; flight.py judges the tracks of the
real front-end. degradations.py makes images worse, by degrees, for both; tables.py shows what came out.
"""
