"""Metrics: statistics of requests, the list of metrics and their export to Prometheus.

May import schemas.
Begin with metric_list.py.
"""
