"""What serves a user beside a run: conformance checks, the doctor, fits, files for others, views, spikes."""
