"""The discrete spaces, and what is assembled on one mesh.

Elements, facets, geometry as arrays, formulas and their values at points, the problem, its
conditions and its forms, and the seam that a physics stands behind.
"""
