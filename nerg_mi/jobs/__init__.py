"""What people do with fields, one file a job: inputs and typed options in, a result out, progress told."""
