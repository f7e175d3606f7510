"""Aligns scored views to a trained scene."""
