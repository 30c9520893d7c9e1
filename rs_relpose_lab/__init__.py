"""The laboratory: simulation, live rig and experiments; the product imports none of it."""
