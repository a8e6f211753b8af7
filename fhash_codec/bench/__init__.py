"""Measurements that stay in the product."""
