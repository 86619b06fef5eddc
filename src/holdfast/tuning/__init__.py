"""What simulated trials say of settings and problems: tables, comparisons, sweeps."""
