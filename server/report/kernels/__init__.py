"""Compiled functions of the accuracy report: plain descents that what the server does is compared with."""
