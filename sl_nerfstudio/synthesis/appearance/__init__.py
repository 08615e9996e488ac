"""How things look: materials, light, lenses and sensor.

In: points on surfaces, and random generators. Out: light, and images as a camera stores them.
"""
