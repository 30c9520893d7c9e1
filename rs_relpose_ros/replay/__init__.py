"""Run the pipeline over a bag and write what came of it: tables, a summary and pictures."""
