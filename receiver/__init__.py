"""Packets in, heights out."""
