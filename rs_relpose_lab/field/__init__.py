"""`rs_relpose benchmark field`: situations that users report, rebuilt by the simulator."""
