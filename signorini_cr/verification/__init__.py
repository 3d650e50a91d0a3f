"""Solutions that are known, and the errors against them.

Test problems, norms and rates, the abstract error estimate evaluated.
"""
