"""What both ends must agree on: data types, wire format, channel, network; and what their services and commands share.

No HTTP, no clocks, no files.
"""
