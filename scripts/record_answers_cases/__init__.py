"""Parts of scripts/record_answers: inputs, requests, sessions, the product, and the recorded digests.

`product.py` holds all contact with solidcloud. Everything else is plain numbers, made with integers,
sums, products, quotients and square roots, which every machine rounds alike.
"""
