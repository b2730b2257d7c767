"""Unit of the integers with which contact is decided exactly ("exact units")."""

# 2^-26 m = 15 nm (NUMERICS.md N5). A power of two, so that metres times UNITS_PER_METRE is exact in
# float64.
UNITS_PER_METRE = 2.0**26
