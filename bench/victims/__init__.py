"""Victims: the learned drivers and the reference drivers that attacks are aimed at."""
