"""The figures of Salman & Pearson 2016, and its threshold tuning, on simulated sessions."""
