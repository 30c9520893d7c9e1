"""The live rig: plays bags, runs the node in processes, records and measures."""
