"""Parts of the job that bakes gaze on surfaces: what receives it, who looks, partial sums, and files."""
