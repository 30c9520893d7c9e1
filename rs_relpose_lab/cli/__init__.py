"""Commands of ``rs_relpose`` that belong to the laboratory."""
