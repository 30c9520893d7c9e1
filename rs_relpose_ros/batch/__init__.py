"""Many bags: one command over all of them, on the processes of a Dask cluster."""
