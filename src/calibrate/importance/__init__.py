"""Weighted points: proposals they are drawn from, straightened posteriors, and their weights."""
