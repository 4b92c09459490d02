"""Any job on many records: a pool of processes or a cluster, each record once; Monte Carlo over a rig."""
