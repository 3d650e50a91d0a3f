"""The discrete spaces, and what is assembled on one mesh.

Elements, facets, geometry as arrays, the problem and its forms.
"""
