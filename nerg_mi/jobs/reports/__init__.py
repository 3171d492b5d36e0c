"""Parts of the job that writes a report."""
