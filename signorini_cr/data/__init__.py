"""The data of a problem as numbers.

Values, integrals and enclosures of f, g, α, u_D and κ, whether the problem makes sense with them,
and the forms of the scalar equation on one mesh, which are made of them.
"""
