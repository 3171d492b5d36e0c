"""What commands do, each from files to files: trainings, renderings, figures, reports and statistics, with their
options."""
