"""Several processes or machines share work: one protocol of jobs and outcomes, local processes and Ray behind it."""
