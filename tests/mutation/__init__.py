"""Mutation study: small faults planted into the product,
and whether a test notices each of them.
"""
