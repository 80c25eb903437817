"""The mathematics that the back-ends share: inertial factors, initialisation, standstill, recovery."""
