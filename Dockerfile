# An image whose default command is the main job: it simulates and maps a whisker session, prints its score and
# draws its pictures.
#
#   docker build -t ratslam .
#   docker run --rm -v "$PWD/runs:/ratslam/runs" ratslam
#   docker run --rm -v "$PWD/runs:/ratslam/runs" ratslam python -m ratslam run square -o runs/square
FROM python:3.12-slim
WORKDIR /ratslam
COPY . .
RUN python -m venv .venv
RUN .venv/bin/python -m pip install --quiet --no-cache-dir -c constraints.txt .
ENV PATH=/ratslam/.venv/bin:$PATH
CMD ["python", "-m", "ratslam", "run", "whisker_maze", "-o", "runs/whisker_maze"]
