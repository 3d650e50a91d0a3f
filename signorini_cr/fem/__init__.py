"""The discrete spaces, and what is assembled on one mesh.

Elements, facets, geometry as arrays, the problem, its conditions and its forms, and the seam that
a physics stands behind.
"""
