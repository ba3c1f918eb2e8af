"""Long runs: work in items, and engines that do it on this machine or on a cluster."""
