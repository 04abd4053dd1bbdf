"""From a packet's bytes to complete windows of counts."""
