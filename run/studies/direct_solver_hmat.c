/* I + K with K = 1/(4 pi r) h^3 on n^3 points of a cube, compressed and factorised (LL') by hmat-oss, for
   run/study direct_solver: reads b from standard input, writes x = A^-1 b to standard output and the figures, as JSON, to
   standard error. Arguments: n, tolerance.   cc -O3 -march=native direct_solver_hmat.c -lhmat -lm */
#include <hmat/hmat.h>
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

typedef struct { int row_start, col_start; const int *row, *col; } block_t;

static double *points, h;

static double entry(int i, int j) {
  double x = points[3 * i] - points[3 * j], y = points[3 * i + 1] - points[3 * j + 1];
  double z = points[3 * i + 2] - points[3 * j + 2], r = sqrt(x * x + y * y + z * z);
  return (i == j) + h * h * h / (4 * M_PI) * (i == j ? 2.38 / h : 1 / r);
}

static void prepare(int row_start, int row_count, int col_start, int col_count, int *row, int *row_back, int *col,
                    int *col_back, void *context, hmat_block_info_t *info) {
  (void)row_count, (void)col_count, (void)row_back, (void)col_back, (void)context;
  block_t *block = malloc(sizeof *block);
  block->row_start = row_start, block->col_start = col_start, block->row = row, block->col = col;
  info->user_data = block;
  info->release_user_data = free;
}

static void compute(void *data, int row, int rows, int col, int cols, void *out) {
  const block_t *block = data;
  for (int j = 0; j < cols; j++)
    for (int i = 0; i < rows; i++)
      ((double *)out)[(size_t)j * rows + i] =
          entry(block->row[block->row_start + row + i], block->col[block->col_start + col + j]);
}

static double seconds(void) { return (double)clock() / CLOCKS_PER_SEC; }

int main(int argc, char **argv) {
  if (argc != 3) return 2;
  int n = atoi(argv[1]), size = n * n * n;
  double eps = atof(argv[2]), *b = malloc(size * sizeof *b);
  h = 1.0 / n;
  points = malloc(3 * size * sizeof *points);
  for (int i = 0; i < size; i++)
    points[3 * i] = i / n / n * h, points[3 * i + 1] = i / n % n * h, points[3 * i + 2] = i % n * h;
  if (fread(b, sizeof *b, size, stdin) != (size_t)size) return 2;
  hmat_interface_t hmat;
  hmat_init_default_interface(&hmat, HMAT_DOUBLE_PRECISION);
  if (hmat.init()) return 2;
  double start = seconds();
  hmat_clustering_algorithm_t *median = hmat_create_clustering_median();
  hmat_cluster_tree_t *tree = hmat_create_cluster_tree(points, 3, size, median);
  hmat_admissibility_t *condition = hmat_create_admissibility_standard(2.0);
  hmat_matrix_t *A = hmat.create_empty_hmatrix_admissibility(tree, tree, 1, condition);
  hmat.set_low_rank_epsilon(A, eps);
  hmat_assemble_context_t assemble;
  hmat_assemble_context_init(&assemble);
  assemble.compression = hmat_create_compression_aca_plus(eps);
  assemble.prepare = prepare;
  assemble.block_compute = compute;
  assemble.lower_symmetric = 1;
  assemble.progress = NULL;
  if (hmat.assemble_generic(A, &assemble)) return 2;
  double assembled = seconds();
  hmat_factorization_context_t factorize;
  hmat_factorization_context_init(&factorize);
  factorize.factorization = hmat_factorization_llt;
  factorize.progress = NULL;
  if (hmat.factorize_generic(A, &factorize)) return 2;
  double factorized = seconds();
  hmat.vector_reorder(b, tree, 0, NULL, 1);
  hmat.solve_dense(A, b, 1);
  hmat.vector_restore(b, tree, 0, NULL, 1);
  double solved = seconds();
  hmat_info_t info;
  hmat.get_info(A, &info);
  fprintf(stderr, "{\"compress_s\": %g, \"invert_s\": %g, \"apply_s\": %g, \"bytes\": %g}\n", assembled - start,
          factorized - assembled, solved - factorized, 8.0 * info.compressed_size);
  return fwrite(b, sizeof *b, size, stdout) != (size_t)size;
}
