"""What both ends must agree on: data types, wire format, channel, network. No HTTP, no clocks, no files."""
