"""The data of a problem as numbers.

Values, integrals and enclosures of f, g, α, u_D and κ, and whether the problem makes sense with
them.
"""
