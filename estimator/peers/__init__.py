"""Estimators of other libraries behind the interface of slamgym's own.

``catalogue`` lists them without importing their libraries.
"""
