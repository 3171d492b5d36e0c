"""Attention statistics of AOIs: hits, visits, dwell time, hit ratio, and confidence intervals over participants."""
