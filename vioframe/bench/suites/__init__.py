"""Suites: a grid of detectors, back-ends, sequences, conditions and seeds, flown and kept so that it can be resumed.

From the outside in: :mod:`.suite` is the YAML file, :mod:`.plan` the tasks it means on the data at hand, :mod:`.sweep`
gets them done by the workers of a cluster, :mod:`.tasks` is what a worker does, :mod:`.store` keeps what comes of it.
"""
