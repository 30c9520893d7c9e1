"""Names of files of results that more than one command knows."""

SUMMARY_FILE = 'summary.json'
